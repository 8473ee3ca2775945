"""Emulate motor controllers of any protocol: motors, gears and the arm behind them, faults, buses, and time."""
