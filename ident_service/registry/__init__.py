"""Store arms, jobs, runs, acceptances, tokens and the audit trail of the service in one SQLite file.

Folders remain the primary store of results; `registry.runs` and `operations.acceptance` can rebuild their tables
from them.
"""
