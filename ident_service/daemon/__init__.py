"""Serve: the HTTP API, jobs, schedules and pages of one daemon per state folder."""
