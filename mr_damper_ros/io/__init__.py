"""Files: bags and record files (text, CSV, MAT, TDMS, MF4, XLSX), with their units."""
