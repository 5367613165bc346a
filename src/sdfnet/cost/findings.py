"""What the studies say, in sentences with numbers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sdfnet.cost.frontier import cheapest, factor_per_digit, knee, pareto_front
from sdfnet.cost.studies import SECONDS, Point, Study, duration_text

STUDIES_OF_THE_WHOLE = {  # whose overrides can be given together, and which error each has
    "simulation_time": "root mean square displacement",
    "distances": "root mean square distance",
    "training": "mean distance error within 1 % of the diagonal",
    "reconstruction": "chamfer L1",
}
SAME = 1.05  # costs that differ by less are called the same
WORTH_A_SETTING = 0.01  # of the whole: what saves less is not worth another setting than the default


@dataclass(frozen=True)
class Whole:
    """A time step, a way to the distances, a training and a grid that together are the cheapest run of a wanted accuracy."""

    wanted_mm: float
    points: tuple[Point, ...]  # with the seconds of the whole run; empty when no combination is accurate enough
    mesh_seconds: float  # of the tet mesh, which every run needs
    mesh_error_mm: float | None  # of the tet mesh itself; None where it was not measured
    parts: tuple[str, ...] = ()  # what its studies say of the part that they measured

    @property
    def error_mm(self) -> float:
        """The errors added up."""
        return sum(point.pair[0] for point in self.points)

    @property
    def seconds(self) -> float:
        """The seconds of the tet mesh, the whole motion, the training, and the distances and the reconstruction of every frame."""
        return self.mesh_seconds + sum(point.pair[1] for point in self.points)

    @property
    def overrides(self) -> list[str]:
        """What `train.py` must be told beside what the studies were told."""
        return [override for point in self.points for override in point.overrides]

    def words(self) -> str:
        """The answer in sentences."""
        if not self.points:
            return f"{self.wanted_mm:g} mm: no time step, distances, training and grid that were measured are accurate enough."
        chosen = "; ".join(f"{error}: {point.words()}" for error, point in zip(STUDIES_OF_THE_WHOLE.values(), self.points, strict=True))
        stages = " ".join([f"{chosen}.", *self.parts])
        mesh = ""
        if self.mesh_error_mm is not None:
            mesh = f"; the tet mesh itself differs from quadratic tets by {self.mesh_error_mm:.3g} mm (simulation_space), which is not among them"
        return (
            f"{self.wanted_mm:g} mm: {duration_text(self.seconds)} for the tet mesh ({duration_text(self.mesh_seconds)}), the whole motion, the training, and "
            f"the distances and the reconstruction of every frame. Their errors sum to {self.error_mm:.3g} mm{mesh}. {stages}"
        )


def front_of(study: Study) -> list[Point]:
    """The points that none beats in both error and cost, most accurate first, without the reference."""
    points = [point for point in study.points if not point.is_reference]
    return [points[place] for place in pareto_front([point.pair for point in points])]


def knee_of(study: Study) -> Point | None:
    """The point of the front from which on a digit costs more than it did before."""
    front = front_of(study)
    place = knee([point.pair for point in front])
    return None if place is None else front[place]


def findings_of(study: Study) -> list[str]:
    """The study in a few sentences: the most accurate and the cheapest, the knee, what a digit costs, and how the default stands."""
    front, bend = front_of(study), knee_of(study)
    failed = [point.failure for point in study.points if point.failure is not None]
    if not front:
        return [f"Nothing could be measured: {'; '.join(sorted(set(failed))) or 'there is the reference alone'}."]
    cost, cheapest_is = ("time", "Quickest") if front[0].cost == SECONDS else ("size", "Smallest")
    sentences = [f"Most accurate: {front[0].words()}."]
    if len(front) > 1:
        sentences.append(f"{cheapest_is}: {front[-1].words()}.")
    factor = factor_per_digit([point.pair for point in front])
    if factor is not None:
        sentences.append(f"Along the front a tenth of the error costs {'the same' if factor < SAME else f'{_times(factor)} the'} {cost}.")
    if bend is not None:
        sentences.append(f"The knee is {bend.words()}.")
    sentences += [_of_default(point, front) for point in study.points if point.is_default and point.is_measured and not point.is_reference]
    if failed:
        sentences.append(f"{len(failed)} of {len(study.points)} points failed and stay in the table with their reason.")
    return [*sentences, *([study.part] if study.part else []), *study.notes]


def cheapest_whole(studies: Sequence[Study], wanted_mm: float, mesh_seconds: float) -> Whole | None:
    """The cheapest points, one of each study of the whole, whose errors add up to at most `wanted_mm`; None where one was not measured.

    Only what a command can be told to do is chosen, and no training whose network was found without a surface. Seconds are
    scaled from what each study ran to the whole run; those of the reconstruction are of one network, whichever is chosen.
    Errors are added as if they all pointed the same way; those of a study of a part of the motion are that part's. The error
    of the tet mesh is not among them: it is that of another solution, and the accuracy is about the simulated solid.
    """
    if unmeasured(studies):
        return None
    by_name = {study.name: study for study in studies}
    possible = {name: _for_the_whole(by_name[name]) for name in STUDIES_OF_THE_WHOLE}
    networks = [point for point in by_name["network_frame"].points if point.method == "network"] if "network_frame" in by_name else []
    lost = {(point.overrides, point.is_default) for point in networks if point.failure is not None}
    possible["training"] = [point for point in possible["training"] if (point.overrides, point.is_default) not in lost]
    stages = list(possible.values())
    places = cheapest([[point.pair for point in points] for points in stages], wanted_mm)
    chosen = () if places is None else tuple(points[place] for points, place in zip(stages, places, strict=True))
    little = WORTH_A_SETTING * sum(point.pair[1] for point in chosen)
    chosen = tuple(_default_if_as_good(point, points, little) for point, points in zip(chosen, stages if chosen else (), strict=True))
    in_space = by_name["simulation_space"].points if "simulation_space" in by_name else ()
    mesh_errors = [point.error_mm for point in in_space if point.is_default and point.is_measured and not point.is_reference]
    parts = tuple(f"{name}: {by_name[name].part}" for name in STUDIES_OF_THE_WHOLE if by_name[name].part)
    return Whole(wanted_mm, chosen, mesh_seconds, mesh_errors[0] if mesh_errors else None, parts)


def _default_if_as_good(chosen: Point, points: Sequence[Point], little: float) -> Point:
    """The default where it is no less accurate and takes but a little longer, s."""
    same = [point for point in points if point.is_default and point.pair[0] <= chosen.pair[0] and point.pair[1] <= chosen.pair[1] + little]
    return next(iter(same), chosen)


def unmeasured(studies: Sequence[Study]) -> list[str]:
    """The studies of the whole that are missing or have no point that a command can be told to do."""
    measured = [study.name for study in studies if _for_the_whole(study)]
    return [name for name in STUDIES_OF_THE_WHOLE if name not in measured]


def _for_the_whole(study: Study) -> list[Point]:
    """The points that a command can be told to do, with the seconds of a whole run."""
    return [
        replace(point, seconds=point.seconds.divided_by(study.share_of_whole))
        for point in study.points
        if point.is_measured and point.seconds is not None and (point.is_default or point.overrides)
    ]


def _of_default(point: Point, front: Sequence[Point]) -> str:
    if point in front:
        return f"The default is on the front: {point.words()}."
    better = [one for one in front if one.pair[0] <= point.pair[0]][-1]  # the cheapest that is no less accurate
    factor, cheap = point.pair[1] / better.pair[1], "quick" if point.cost == SECONDS else "small"
    if factor < SAME or (point.seconds is not None and better.seconds is not None and point.seconds.p5 <= better.seconds.p95):
        return f"The default, {point.words()}, is as {cheap} as {better.words()}, which is no less accurate."
    return f"The default, {point.words()}, is beaten by {better.words()}: {_times(factor)} {cheap}er and no less accurate."


def _times(factor: float) -> str:
    """1.4 times, 210 times, 34,000 times."""
    return f"{float(f'{factor:.2g}'):,.15g} times"
