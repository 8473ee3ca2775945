"""Provide the interface `ident_wire`: a CAN bus among processes of one user, over a local socket.

It orders frames as arbitration does, can keep the pace of a bit rate, and lets errors be injected; for emulated drives
where the kernel has no CAN. `can_bus/hub.py` is the wire itself, `can/can_link.py` an end of it, `can_bus/bus.py` an
end for python-can.
"""
