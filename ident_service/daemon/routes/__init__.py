"""Define the routes of the HTTP API; `app.create_app` builds the application."""
