"""What the service remembers: arms, jobs, runs, acceptances, access, and who did what; one SQLite file.

Folders stay the truth about results: `runs.index_runs` and `acceptances` can rebuild their tables from them.
"""
