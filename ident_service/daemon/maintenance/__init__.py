"""Re-identify arms: schedules and due entries, the steps, the verdict, and the drift alarm that it may raise."""
