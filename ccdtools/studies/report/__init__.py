"""The report of a finished run: tables, figures and one self-contained page."""
