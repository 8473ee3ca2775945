"""Make the report: one self-contained page from evidence and parameters. `report_files.py` handles its files."""
