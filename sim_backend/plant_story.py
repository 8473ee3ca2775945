"""Collect the extremes of a plant's motion every period, and write them where others can read them."""

from __future__ import annotations

import mmap
import os

import numpy as np

from sim_backend.machine import Machine
from sim_backend.plant_status import PlantState, PlantStatus, encode_status, status_size

_EVERY = 20  # periods between two writings, when nothing happens


class PlantStory:
    """Collect and write the status record of one machine."""

    def __init__(self, machine: Machine, descriptor: int) -> None:
        """Start, and write the first record.

        Args:
            machine: whose status is recorded.
            descriptor: of the file or anonymous memory to write into; it is made as long as needed.
        """
        joints = machine.plant.chain.joints
        os.ftruncate(descriptor, status_size(joints))
        self._map = mmap.mmap(descriptor, status_size(joints))
        self._machine = machine
        self.state = PlantState.WAITING
        self.silent_ticks = 0
        self._ticks = self._clients = self._client_pid = self._unwritten = 0
        self._lowest, self._highest = machine.plant.position.copy(), machine.plant.position.copy()
        self._velocity, self._torque = np.zeros(joints), np.zeros(joints)
        self._silent_velocity, self._silent_torque = np.zeros(joints), np.zeros(joints)
        self.write()

    def serve(self, pid: int) -> None:
        """Record that a client has connected."""
        self._clients, self._client_pid = self._clients + 1, pid
        self.heard()
        self.become(PlantState.SERVING)

    def settle(self) -> None:
        """Record that the client is gone."""
        self._client_pid = 0
        self.become(PlantState.AT_REST if self._machine.supported else PlantState.SETTLING)

    def become(self, state: PlantState, *, quiet: int = 0) -> None:
        """Enter a state; `quiet` periods of the silence were spent at rest."""
        self.state = state
        self.silent_ticks -= quiet
        self.write()

    def end(self) -> None:
        """Record that the process ends."""
        resting = self.state is PlantState.AT_REST or self._machine.supported
        self.become(PlantState.ENDED_AT_REST if resting else PlantState.ENDED_MOVING)

    def heard(self) -> None:
        """Record that a frame has come; silence is counted from here."""
        if self.silent_ticks:
            self.silent_ticks = 0
        self._silent_velocity[:] = 0.0
        self._silent_torque[:] = 0.0

    def moved(self, *, silent: bool) -> None:
        """Record the motion of a period that is over."""
        plant = self._machine.plant
        speed, torque = np.abs(plant.velocity), np.abs(self._machine.torque)
        np.minimum(self._lowest, plant.position, out=self._lowest)
        np.maximum(self._highest, plant.position, out=self._highest)
        np.maximum(self._velocity, speed, out=self._velocity)
        np.maximum(self._torque, torque, out=self._torque)
        if silent:
            self.silent_ticks += 1
            np.maximum(self._silent_velocity, speed, out=self._silent_velocity)
            np.maximum(self._silent_torque, torque, out=self._silent_torque)
        self._ticks += 1
        self._unwritten += 1
        if self._unwritten >= _EVERY:
            self.write()

    def write(self) -> None:
        """Write the record now."""
        plant = self._machine.plant
        record = encode_status(
            PlantStatus(
                self.state,
                os.getpid(),
                self._client_pid,
                self._clients,
                self._ticks,
                self.silent_ticks,
                plant.period,
                plant.position,
                plant.velocity,
                self._lowest,
                self._highest,
                self._velocity,
                self._torque,
                self._silent_velocity,
                self._silent_torque,
            )
        )
        self._map[: len(record)] = record
        self._unwritten = 0
