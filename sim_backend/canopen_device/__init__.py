"""Emulate the CANopen protocol of a motor controller (CiA 301, CiA 402): frames in, frames out, no clock."""
