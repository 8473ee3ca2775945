"""Estimate sequentially while an arm moves: the R factor of the samples so far, and the remaining uncertainty.

New samples wait until they make a window long enough for the zero-phase filter; the window's equations are merged into
the factor (`model/information.py`) and all but its end is forgotten. Work and memory of a step are bounded, whatever
the length of the run. Deviations by eq. 81, which takes residuals for white, show how the uncertainty shrinks. Those of
the result come from blocks and are larger. Decisions while the arm moves use the larger of both; for them the
information of each block is kept, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.estimation.equations import LEAST_BLOCKS, Equations, Rows, equation_rows, with_merged_blocks
from ident_service.estimation.least_squares import ordinary_least_squares
from ident_service.estimation.spectra import EDGE, USUAL
from ident_service.estimation.uncertainty import Verdict, negligible, uncertainty, verdicts
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import base_parameters
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.information import empty_information, information_of, sparsity
from ident_service.recordings.recording import BLOCK_SAMPLES, Block, Stamps, cut, join

_FIRST = 2.0  # s, length of the first window; it grows where the filter needs more
_LONGEST = 60.0  # s
_MOST = 10.0  # s beyond the shortest window that are worked on in one step


@dataclass(frozen=True)
class ParameterUncertainty:
    """Parameter uncertainty after the samples processed so far.

    Attributes:
        seconds: length of the motion processed [s].
        beta: least squares, each joint's equations divided by its residual [SI], shape (base,).
        deviations: standard deviations by eq. 81, or by the blocks where those are kept and say more [SI], shape
            (base,); infinite where nothing is known yet.
        negligible: sizes below which parameters are as good as zero on the motion so far [SI], shape (base,).
        verdicts: a word per base parameter.
        blocks: number of blocks that were kept, repetitions of the same motion counted once.
        until_ns: stamp of the last sample that went in.
    """

    seconds: float
    beta: Array
    deviations: Array
    negligible: Array
    verdicts: tuple[Verdict, ...]
    blocks: int = 0
    until_ns: int = 0


class SequentialLeastSquares:
    """Sequential least squares over the samples of one run.

    Attributes:
        base: the grouping of the parameters.
    """

    def __init__(self, model: ArmModel, *, in_blocks: bool = False, period: float | None = None) -> None:
        """Start without samples.

        Args:
            model: of the arm; averaging over periods and trimming, which need a whole recording, are left out.
            in_blocks: whether the information of each block is kept, and deviations are as careful as the result's.
            period: of the motion [s], if it has one: its repetitions are no independent evidence (`repeats.py`).
        """
        options = model.config.identification
        smoothing = options.smoothing
        if smoothing.cutoff == "choose":  # windows of a few seconds are too short to choose a cut-off from
            smoothing = smoothing.model_copy(update={"cutoff": USUAL})
        self._edge = EDGE / USUAL if options.edge == "choose" else options.edge
        options = options.model_copy(update={"period": None, "smoothing": smoothing, "edge": self._edge})
        config = model.config.model_copy(update={"identification": options, "recording": RecordingFormat()})
        self._model = replace(model, config=config)
        self.base = base_parameters(model.chain, model.layout)
        self._supports = sparsity(model.chain, model.layout, self.base.base)
        self._information = empty_information(self._supports, self.base.size)
        self._blocks = Equations((), 0) if in_blocks else None
        self._phases = max(LEAST_BLOCKS, round(period / options.block)) if period else 0
        self._length = period / self._phases if period else options.block
        self._number, self._origin_ns = -1, -1
        self._waiting: list[Block] = []
        self._need, self._done_ns, self._seconds = _FIRST, -1, 0.0

    def add(self, block: Block) -> None:
        """Queue samples, consecutive to those before, for `step`; compute nothing."""
        self._waiting.append(block)

    @one_blas_thread()
    def step(self) -> bool:
        """Process a bounded part of the queued samples; return whether rows were added to the estimate."""
        if not self._waiting:
            return False
        whole = join(self._waiting)
        self._waiting = [whole]
        first = int(whole.stamp_ns[0])
        if (int(whole.stamp_ns[-1]) - first) * 1e-9 < self._need:
            return False
        stop = int(np.searchsorted(whole.stamp_ns, first + int((self._need + _MOST) * 1e9)))
        window = cut(whole, 0, stop)
        try:
            found = self._merge(window)
        except RecordingError:  # too short for the filter
            if self._need >= _LONGEST:
                self._waiting = [cut(whole, stop, len(whole.stamp_ns))] if stop < len(whole.stamp_ns) else []
            self._need = min(1.5 * self._need, _LONGEST)
            return False
        # The next window looks at the end of this one again, because its own edges are left out.
        edge = self._edge
        keep = int(np.searchsorted(whole.stamp_ns, self._done_ns - int((edge + 0.1) * 1e9)))
        self._waiting = [cut(whole, max(keep, 0), len(whole.stamp_ns))]
        return found

    def _merge(self, window: Block) -> bool:
        first, found = int(window.stamp_ns[0]), False
        for rows in equation_rows(_Window(window, self._model.chain.names), self._model, self.base):
            time_ns = first + np.rint(rows.time * 1e9).astype(np.int64)
            new = time_ns > self._done_ns
            if not new.any():
                continue
            block = information_of(rows.H_b[:, :, new], rows.torque[new], rows.keep[new], self._supports)
            self._information = self._information.merged(block)
            if self._blocks is not None:
                self._blocks = self._extended(self._blocks, rows, time_ns, new)
            self._seconds += float(rows.time[new][-1] - rows.time[new][0])
            self._done_ns, found = int(time_ns[-1]), True
        return found

    def _extended(self, before: Equations, rows: Rows, time_ns: Stamps, new: NDArray[np.bool_]) -> Equations:
        """Return the equations with new rows added by stretches of time, as `equations.py` does for a recording."""
        blocks, labels = list(before.blocks), list(before.labels)
        if self._origin_ns < 0:
            self._origin_ns = int(time_ns[new][0])
        numbers = (time_ns - self._origin_ns) // int(self._length * 1e9)
        for number in np.unique(numbers[new]).tolist():
            part = new & (numbers == number)
            block = information_of(rows.H_b[:, :, part], rows.torque[part], rows.keep[part], self._supports)
            if number == self._number:
                blocks[-1] = blocks[-1].merged(block)
            else:
                blocks.append(block)
                labels.append((0, number % self._phases if self._phases else number))
            self._number = number
        return with_merged_blocks(Equations(tuple(blocks), 0, (), tuple(labels)))

    @one_blas_thread()
    def uncertainty(self) -> ParameterUncertainty | None:
        """Return estimate, deviations and verdicts of the samples so far; None unless rows outnumber parameters."""
        information = self._information
        if int(information.rows.sum()) <= self.base.size:
            return None
        fit = ordinary_least_squares(information)
        spread = np.sqrt(information.squared_residuals(fit.beta) / np.maximum(information.rows, 1))
        floor = 1e-9 * np.sqrt(information.squared_torques() / np.maximum(information.rows, 1)) + 1e-300
        fit = ordinary_least_squares(information, np.where(information.rows > 0, 1.0 / np.maximum(spread, floor), 1.0))
        deviations, clusters = fit.standard_deviations, 0
        if self._blocks is not None and self._blocks.blocks:
            clusters = len(self._blocks.clusters)
            found = uncertainty(self._blocks, fit)
            deviations = np.maximum(deviations, found.deviations)
        as_zero = negligible(information)
        words = verdicts(fit.beta, deviations, as_zero)
        return ParameterUncertainty(self._seconds, fit.beta, deviations, as_zero, words, clusters, self._done_ns)


class _Window:
    """Samples that implement the recording protocol; torques are held from stamp to stamp."""

    torque_zero_order_hold, torn, sha256 = True, False, ""
    path = Path("the run so far")

    def __init__(self, block: Block, names: tuple[str, ...]) -> None:
        self._block, self.joint_names, self.joints = block, names, len(names)

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Yield the samples in order, at most `samples` at a time."""
        for start in range(0, len(self._block.stamp_ns), samples):
            yield cut(self._block, start, min(start + samples, len(self._block.stamp_ns)))
