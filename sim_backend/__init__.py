"""Simulate arms: a plant with true parameters behind the `Arm` contract, and emulated drives on a bus."""
