"""The page: what the API does, for a browser; rendered here, with a little script that only adds comfort."""
