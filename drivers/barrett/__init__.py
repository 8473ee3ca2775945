"""Drive pucks, the motor controllers of a Barrett WAM, in their own protocol."""
