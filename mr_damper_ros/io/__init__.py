"""Files: bags, text, CSV and MAT records, and their units."""
