"""Provide the interface `ident_wire`: a CAN bus among processes of one user, over a local socket.

It orders frames as arbitration does, can keep the pace of a bit rate, and lets errors be injected; for emulated drives
where the kernel has no CAN. `can_bus/hub.py` is the bus itself, `can_bus/link.py` an endpoint, `can_bus/bus.py`
an endpoint for python-can.
"""
