"""Move arms: reference trajectories, control law, safety monitor, state machine and the control loop."""
