"""Re-identification: when it is due, the steps that do it, its verdict, and the alarm that it may raise."""
