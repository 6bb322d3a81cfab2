"""Files: bags and record files (text, CSV, MAT, TDMS, XLSX), with their units."""
