"""Move arms: reference trajectories, control law, safety guard, state machine and the control loop."""
