"""Store arms, jobs, runs, acceptances, tokens and the audit trail of the service in one SQLite file.

Folders stay the truth about results: `runs.index_runs` and `acceptances` can rebuild their tables from them.
"""
