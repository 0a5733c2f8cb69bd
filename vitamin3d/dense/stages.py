# SPDX-License-Identifier: Apache-2.0
"""The dense half as a chain of stages (Sec. 4.2): densify, mesh and check. Each has three verbs and does not know the others.

What goes in comes out later, or not at all: a stage may wait for neighbours. `push` takes one item, in the order of time; `expire`
says how late it is; `flush` says that no more will follow. Each gives those that are ready (`Stage` in `steps.py`).
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Generic, TypeVar

from vitamin3d.config import Config, ConsistencyConfig
from vitamin3d.dense.consistency import voted
from vitamin3d.dense.delaunay import triangulate
from vitamin3d.dense.densification import CanvasPicture, Densifier
from vitamin3d.dense.depth_rendering import DepthRenderer
from vitamin3d.dense.extrapolation import extended, outline
from vitamin3d.dense.nltgv import denoise
from vitamin3d.dense.view_graph import Neighbourhood, ViewGraph
from vitamin3d.dense.view_selection import ViewSelection, view_stride
from vitamin3d.geometry.cameras import Camera
from vitamin3d.steps import Stage
from vitamin3d.types import DepthView, MapSnapshot, NewestFrame, StepTimes

In = TypeVar("In", contravariant=True)
Out = TypeVar("Out", covariant=True)


class Densifying:
    """Chooses the keyframes that become views, and gives them more vertices with the help of their neighbours."""

    def __init__(self, camera: Camera, renderer: DepthRenderer, config: Config, times: StepTimes, num_keyframes: int) -> None:
        densification = config.densification
        self._renderer, self._times, self._max_wait_s = renderer, times, densification.max_wait_s
        self._densifier = Densifier(camera, renderer.canvas, densification)
        selection = ViewSelection(camera, view_stride(num_keyframes, densification), densification.view_motion_px)
        self._graph: ViewGraph[CanvasPicture] = ViewGraph(densification.reach, lambda p: selection.is_view(p.snapshot))

    def push(self, item: MapSnapshot) -> Iterator[MapSnapshot]:
        yield from map(self._densified, self._graph.push(CanvasPicture(item, self._renderer.draw_gray, self._renderer.is_outside)))
        yield from self.expire(item.frame.timestamp_ns)

    def expire(self, now_ns: int) -> Iterator[MapSnapshot]:
        late = self._graph.expire(lambda p: _is_older(p.snapshot.frame.timestamp_ns, now_ns, self._max_wait_s))
        yield from map(self._densified, late)

    def flush(self) -> Iterator[MapSnapshot]:
        yield from map(self._densified, self._graph.flush())

    def clear(self) -> None:
        self._graph.clear()

    def _densified(self, view: Neighbourhood[CanvasPicture]) -> MapSnapshot:
        with self._times.timed("densification"):
            return self._densifier.densify(view)


class Meshing:
    """Triangulates, denoises, extrapolates and draws a keyframe; those with too few landmarks do not come out."""

    def __init__(self, camera: Camera, renderer: DepthRenderer, config: Config, times: StepTimes) -> None:
        self._renderer, self._config, self._times = renderer, config, times
        self._border = outline(camera, config.extrapolation.spacing_px)

    def push(self, item: MapSnapshot) -> Iterator[DepthView]:
        with self._times.timed("meshing"):
            mesh = triangulate(item, self._config.delaunay)
        if mesh is None:
            return
        with self._times.timed("denoising"):
            denoised = denoise(mesh, self._config.nltgv)
        mesh, slopes = denoised.mesh, denoised.slopes
        if self._config.extrapolation.enabled:
            with self._times.timed("extrapolation"):
                mesh, slopes = extended(mesh, slopes, self._border, self._config.extrapolation)
        with self._times.timed("rendering"):
            yield self._renderer.render(item, mesh, slopes)

    def expire(self, now_ns: int) -> Iterator[DepthView]:
        return iter(())

    def flush(self) -> Iterator[DepthView]:
        return iter(())

    def clear(self) -> None:
        """Nothing waits."""


class Checking:
    """Leaves out of each view what those around it contradict."""

    def __init__(self, canvas: Camera, config: ConsistencyConfig, times: StepTimes) -> None:
        self._canvas, self._config, self._times = canvas, config, times
        self._graph: ViewGraph[DepthView] = ViewGraph(config.reach)

    def push(self, item: DepthView) -> Iterator[DepthView]:
        yield from map(self._checked, self._graph.push(item))
        yield from self.expire(item.timestamp_ns)

    def expire(self, now_ns: int) -> Iterator[DepthView]:
        wait_s = self._config.max_wait_s
        yield from map(self._checked, self._graph.expire(lambda view: _is_older(view.timestamp_ns, now_ns, wait_s)))

    def flush(self) -> Iterator[DepthView]:
        yield from map(self._checked, self._graph.flush())

    def clear(self) -> None:
        self._graph.clear()

    def _checked(self, around: Neighbourhood[DepthView]) -> DepthView:
        consistency = self._config
        voters = [side[k - 1] for side in (around.before, around.after) for k in consistency.offsets if k <= len(side)]
        with self._times.timed("consistency"):
            return voted(around.item, voters, self._canvas, consistency.tolerance, consistency.contradicted_weight)


class Chain(Generic[In, Out]):
    """Several stages, one after the other, as one; none lets everything through as it is."""

    def __init__(self, *stages: Stage[Any, Any]) -> None:
        self._stages = stages

    def push(self, item: In) -> Iterator[Out]:
        return self._through([item], 0)

    def expire(self, now_ns: int) -> Iterator[Out]:
        for k, stage in enumerate(self._stages):
            yield from self._through(stage.expire(now_ns), k + 1)

    def flush(self) -> Iterator[Out]:
        for k, stage in enumerate(self._stages):
            yield from self._through(stage.flush(), k + 1)

    def clear(self) -> None:
        for stage in self._stages:
            stage.clear()

    def _through(self, items: Iterable[Any], first: int) -> Iterator[Any]:
        """What comes of items that enter the stages from the `first` on."""
        if first == len(self._stages):
            yield from items
            return
        for item in items:
            yield from self._through(self._stages[first].push(item), first + 1)


def _is_older(timestamp_ns: int, now_ns: int, seconds: float) -> bool:
    """Whether something is older than so many seconds; never with 0."""
    return seconds > 0 and now_ns - timestamp_ns > 1e9 * seconds


def staged(messages: Iterable[Any], stage_of: Callable[[int], Stage[Any, Any]]) -> Iterator[Any]:
    """What comes of a run's keyframes, or views, in one stage of their maps' chains, by the number of the map.

    Where another map's come, those of the one before wait no longer. `NewestFrame`, which says how late it is, goes on behind them.
    """
    newest: Stage[Any, Any] | None = None
    for message in messages:
        if not isinstance(message, NewestFrame):
            here = stage_of(message.map_number)
            if newest is not None and newest is not here:
                yield from newest.flush()
            newest = here
            yield from here.push(message)
            if isinstance(message, MapSnapshot):
                yield from here.expire(message.frame.timestamp_ns)
        elif newest is not None:
            yield from newest.expire(message.timestamp_ns)
            yield message
    if newest is not None:
        yield from newest.flush()
