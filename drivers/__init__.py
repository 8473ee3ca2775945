"""Drivers: the Arm contract and one module per fieldbus arm; nothing here knows of identification."""
