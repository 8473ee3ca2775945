"""The ring with a writer and readers in processes of their own, killed at random."""

from __future__ import annotations

import json
import os
import random
import subprocess
import time

import pytest
from ring_actors import command, holders, inode

from ident_service.record import ring_memory
from ident_service.record.ring import RingReader, create_ring


def campaign(rounds: int, seed: int) -> None:
    """A writer and two readers in processes of their own; the writer is killed, sometimes a reader too."""
    chance = random.Random(seed)  # noqa: S311
    returned = lost = 0
    for _ in range(rounds):
        fd = create_ring(3, chance.choice([4, 64, 4096]))
        number = inode(fd)
        plan = [("writer", chance.choice([0, 0, 1e-4]))]
        plan += [("reader", chance.choice([0, 0, 0.003])), ("reader", 0.02)]
        processes = [
            subprocess.Popen(command(role, fd, value), pass_fds=[fd], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            for role, value in plan
        ]
        try:
            with RingReader(fd) as watch:
                while not watch.memory.words[ring_memory.WRITTEN]:
                    time.sleep(0.001)
                time.sleep(chance.uniform(0.0, 0.25))
                victim = chance.choice([None, None, processes[1]])
                if victim is not None:
                    victim.kill()
                    time.sleep(chance.uniform(0.0, 0.05))
                processes[0].kill()
                processes[0].wait()
                count = watch.memory.words[ring_memory.WRITTEN]
                count += watch.memory.words[watch.memory.word_of(count)] == 2 * count + 2
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


@pytest.mark.slow
def test_processes_killed_at_random() -> None:
    campaign(2, 5)


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(100, 105))
def test_many_processes_killed_at_random(seed: int) -> None:
    campaign(25, seed)
