"""The ring with a writer and readers in processes of their own, killed at random."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import time

import pytest
from ring_actors import command, holders, inode

from ident_service.recordings import ring_buffer as ring_memory
from ident_service.recordings.ring_buffer import RingReader, create_ring


def campaign(rounds: int, seed: int) -> None:
    """A writer and two readers in processes of their own; the writer is killed, sometimes a reader too."""
    chance = random.Random(seed)  # noqa: S311
    returned = lost = 0
    for number_of_round in range(rounds):
        capacity = (4096, 64, 4)[number_of_round % 3]
        fd = create_ring(3, capacity)
        number = inode(fd)
        plan = [("writer", chance.choice([0, 0, 1e-4]))]
        plan += [("reader", chance.choice([0, 0, 0.003])), ("reader", 0.02)]
        processes = [
            subprocess.Popen(command(role, fd, value), pass_fds=[fd], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            for role, value in plan
        ]
        try:
            with RingReader(fd) as watch:
                written(watch, 1000)  # of which a reader of the largest ring finds all or most, however late it comes
                processes[2].send_signal(signal.SIGSTOP)
                written(watch, watch.memory.words[ring_memory.WRITTEN] + 2 * capacity)
                processes[2].send_signal(signal.SIGCONT)
                time.sleep(chance.uniform(0.0, 0.25))
                victim = chance.choice([None, None, processes[1]])
                if victim is not None:
                    victim.kill()
                    time.sleep(chance.uniform(0.0, 0.05))
                processes[0].kill()
                processes[0].wait()
                count = watch.memory.words[ring_memory.WRITTEN]
                count += watch.memory.words[watch.memory.slot_word_index(count)] == 2 * count + 2
            for process in processes[1:]:
                said, _ = process.communicate(timeout=60)
                if process is not victim:
                    found = json.loads(said)
                    assert found["wrong"] == 0
                    assert found["cursor"] == found["returned"] + found["lost"] == count
                    returned, lost = returned + found["returned"], lost + found["lost"]
            assert holders(number) == {os.getpid()}
        finally:
            for process in processes:
                process.kill()
                process.communicate()
            os.close(fd)
        assert holders(number) == set()
    assert returned > 100 * rounds
    assert lost > 0


def written(watch: RingReader, count: int) -> None:
    """Wait until so many records have been written."""
    while watch.memory.words[ring_memory.WRITTEN] < count:
        time.sleep(0.001)


@pytest.mark.slow
def test_processes_killed_at_random() -> None:
    campaign(3, 5)


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(100, 105))
def test_many_processes_killed_at_random(seed: int) -> None:
    campaign(25, seed)
