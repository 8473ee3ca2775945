"""Identify many arms from many recordings: map and reduce on Dask, a common model, trends, one page."""
