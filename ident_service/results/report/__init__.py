"""The report: evidence and parameters in, one self-contained page out. Files are the business of `report_files.py`."""
