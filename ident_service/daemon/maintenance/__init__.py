"""Re-identify arms on schedule: due entries, steps, verdict and drift alarm."""
