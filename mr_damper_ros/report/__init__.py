"""Documents: tables, figures and HTML pages."""
