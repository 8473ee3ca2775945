"""Run the daemon: HTTP API, jobs, schedules and web pages, one process per state folder."""
