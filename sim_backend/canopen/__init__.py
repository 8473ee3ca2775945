"""The CANopen face of an emulated motor controller (CiA 301, CiA 402): frames in, frames out, no clock."""
