"""The recordings of simulated fleets are those that the recorder writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.fleets import BEGIN, kind, motion, write_samples
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_writer import RecordingWriter


@pytest.mark.parametrize(("arm", "rate"), [("planar2", 100.0), ("wam7_sim", 1000.0)])
def test_samples_written_together_are_those_written_one_by_one(arm: str, rate: float, tmp_path: Path) -> None:
    """Every record of the file, chunks and indexes among them; but velocities of a filter differ in last digits."""
    of, count, offset = kind(arm, rate=rate), 450, round(BEGIN * 1e9) + 123_456_789
    stamps = of.stamps(count)
    position, velocity, torque = motion(of, 1)(stamps * 1e-9)
    names = of.model.chain.names
    ok, age = np.ones(len(names), dtype=bool), np.zeros(len(names), dtype=np.int64)
    with RecordingWriter(tmp_path / "together.mcap", names, "", offset) as writer:
        write_samples(writer, offset, stamps, position, velocity, torque)
    with RecordingWriter(tmp_path / "singly.mcap", names, "", offset) as writer:
        for k in range(count):
            row = (position[k], None, torque[k], position[k], velocity[k])
            writer.sample(Cycle(int(stamps[k]), *row, k, 0, 0, ok, age, 0))
    files = [tmp_path / "together.mcap", tmp_path / "singly.mcap"]
    records, summaries = [], []
    for path in files:
        with path.open("rb") as stream:
            records.append(list(StreamReader(stream, record_size_limit=None, emit_chunks=False).records))
            stream.seek(0)
            summaries.append(make_reader(stream).get_summary())
    assert [type(one) for one in records[0]] == [type(one) for one in records[1]]
    differ = [(one, other) for one, other in zip(*records, strict=True) if one != other]
    assert {type(one).__name__ for one, _ in differ} <= {
        "Message",
        "ChunkIndex",
        "MetadataIndex",
        "DataEnd",
        "Footer",
        "SummaryOffset",
    }
    assert summaries[0] is not None
    assert summaries[1] is not None
    assert summaries[0].statistics == summaries[1].statistics
    chunks = [
        [(one.message_start_time, one.message_end_time, one.uncompressed_size) for one in summary.chunk_indexes]
        for summary in summaries
    ]
    assert chunks[0] == chunks[1]
    floats = 8 * len(names)
    for one, other in differ:
        if type(one).__name__ == "Message":
            assert (one.channel_id, one.log_time, one.sequence) == (other.channel_id, other.log_time, other.sequence)
            # Sequences of doubles at the end: velocity, the torque's count, torque.
            end = len(one.data) - 2 * floats - 8
            assert one.data[:end] == other.data[:end]
            assert one.data[end + floats :] == other.data[end + floats :]
            np.testing.assert_allclose(
                np.frombuffer(one.data[end : end + floats]),
                np.frombuffer(other.data[end : end + floats]),
                rtol=1e-9,
                atol=1e-12,
            )
