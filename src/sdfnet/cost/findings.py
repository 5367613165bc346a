"""What the studies say, in sentences with numbers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sdfnet.cost.frontier import cheapest, factor_per_digit, knee, pareto_front
from sdfnet.cost.studies import Point, Study, duration_text

STUDIES_OF_THE_WHOLE = ("simulation_time", "distances", "training")  # whose errors are of one run and whose overrides can be given together


@dataclass(frozen=True)
class Whole:
    """A time step, a way to the distances and a training that together are the cheapest run of a wanted accuracy."""

    wanted_mm: float
    points: tuple[Point, ...]  # with the seconds of the whole run; empty when no combination is accurate enough

    @property
    def error_mm(self) -> float:
        """The errors added up."""
        return sum(point.pair[0] for point in self.points)

    @property
    def seconds(self) -> float:
        """The seconds of the whole motion, the distances of every frame, and the training."""
        return sum(point.pair[1] for point in self.points)

    def words(self) -> str:
        """The answer in a sentence, with the overrides that make the commands do it."""
        if not self.points:
            return f"{self.wanted_mm:g} mm: no time step, distances and training that were measured are accurate enough."
        overrides = " ".join(override for point in self.points for override in point.overrides)
        chosen = "; ".join(point.words() for point in self.points)
        return (
            f"{self.wanted_mm:g} mm: {duration_text(self.seconds)} for the whole motion, the distances of every frame and the training; their errors sum to "
            f"{self.error_mm:.3g} mm, to which tet mesh and grid add their own: {chosen}. python train.py {overrides}".rstrip()
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
    cost, cheapest_is = ("bytes", "Smallest") if front[0].seconds is None else ("time", "Quickest")
    sentences = [f"Most accurate: {front[0].words()}."]
    if len(front) > 1:
        sentences.append(f"{cheapest_is}: {front[-1].words()}.")
    factor = factor_per_digit([point.pair for point in front])
    if factor is not None:
        sentences.append(f"Along the front a tenth of the error costs {factor:.2g} times the {cost}.")
    if bend is not None:
        sentences.append(f"The knee is {bend.words()}.")
    sentences += [_of_default(point, front) for point in study.points if point.is_default and point.is_measured and not point.is_reference]
    if failed:
        sentences.append(f"{len(failed)} of {len(study.points)} points failed and stay in the table with their reason.")
    return [*sentences, *study.notes]


def cheapest_whole(studies: Sequence[Study], wanted_mm: float) -> Whole | None:
    """The cheapest points, one of each study of the whole, whose errors add up to at most `wanted_mm`; None where one was not measured.

    Only what a command can be told to do is chosen. Seconds are scaled from what each study ran to the whole run. Errors
    are added, the safe side: they may all point the same way. The error of the tet mesh, which is that of another solution,
    and of the grid, which every frame pays again, are not among them: their studies have them.
    """
    by_name = {study.name: _for_the_whole(study) for study in studies}
    stages = [by_name.get(name, []) for name in STUDIES_OF_THE_WHOLE]
    if not all(stages):
        return None
    places = cheapest([[point.pair for point in points] for points in stages], wanted_mm)
    return Whole(wanted_mm, () if places is None else tuple(points[place] for points, place in zip(stages, places, strict=True)))


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
    if point.seconds is not None and better.seconds is not None and point.seconds.p5 <= better.seconds.p95:
        return f"The default, {point.words()}, is as quick as {better.words()}, which is no less accurate."
    cheaper = "smaller" if point.seconds is None else "quicker"
    return f"The default, {point.words()}, is beaten by {better.words()}: {point.pair[1] / better.pair[1]:.2g} times {cheaper} and no less accurate."
