"""Estimation: from equations to parameters a real body could have, with their doubt."""
