"""Serve the HTTP API: everything that the command line does, by ids; `app.create_app` builds the application."""
