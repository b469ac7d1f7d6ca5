"""Report of a finished run: tables, figures and a self-contained page."""
