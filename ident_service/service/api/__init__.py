"""The HTTP API: everything that the command does, by ids; `app.create_app` is the door."""
