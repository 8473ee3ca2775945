"""Serve the web pages: what the API does, for a browser; rendered here, scripts only add comfort."""
