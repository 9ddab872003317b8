"""The causes of marked scans, in words for people: what happened, and what to do about it."""

from typing import NamedTuple


class Cause(NamedTuple):
    """One cause for which scans are marked.

    Attributes:
        happened: what was wrong, and what was done about the step.
        advice: what the user can do.
    """

    happened: str
    advice: str


HELP_MATCHER = (
    "use the wheel odometry if it was recorded (--wheels, --odom-topic); in a tunnel try --model fused"
)

CAUSES = {
    "no returns": Cause(
        "the scan had no returns, or none that could be used; the last motion was repeated",
        "check whether something covered the laser or all walls were out of its range",
    ),
    "few returns": Cause(
        "the scan had few returns; the matcher repeated the last motion, a network used what there was",
        f"check what was around the robot there; {HELP_MATCHER}",
    ),
    "no match": Cause(
        "the scan does not fit the local map; the last motion was repeated",
        f"use every scan (no --every); {HELP_MATCHER}",
    ),
    "new map": Cause(
        "six scans in a row did not fit the local map, so a new map was begun",
        "do not trust the position of the path after it relative to the path before it",
    ),
    "held": Cause(
        "the scan does not determine the motion along one direction, as in a bare corridor; along it the "
        "last motion was repeated",
        f"do not trust the distance there; {HELP_MATCHER}",
    ),
    "poor match": Cause(
        "much of the scan does not fit the map (people, a door that opens, a new room); the match was used",
        "nothing, unless walls are doubled in the map",
    ),
    "sudden motion": Cause(
        "the motion differs from the last one by half a metre or 20 degrees; the match was used",
        "check whether scans are missing or the robot was pushed; if neither, the match may be wrong",
    ),
    "ambiguous": Cause(
        "the scan fits the map almost equally well in two places; the better one was used",
        f"look for doubled walls in the map; {HELP_MATCHER}",
    ),
    "no prior": Cause(
        "the network gave no step; scan matching was used without it",
        "choose a --network that was trained for such a laser",
    ),
    "late scan": Cause(
        "the stamp is not later than the one before; the scan was not used",
        "stamp scans when they are measured, and record them in that order",
    ),
    "clock set": Cause(
        "the stamps jumped by more than ten seconds; no motion was added",
        "treat the path before it and the path after it as two drives",
    ),
    "to and fro": Cause(
        "each step reverses the one before it, as if two lasers wrote to one topic",
        "give each laser its own topic, and choose one with --topic",
    ),
    "other frame": Cause(
        "the scan has another frame_id, as from another laser; it was not used",
        "choose the topic of one laser with --topic",
    ),
    "new frame": Cause(
        "the laser's frame_id changed and stayed different; no motion was added",
        "treat the path before it and the path after it as two drives",
    ),
    "other laser": Cause(
        "the beams do not lie where the network expects them; the scan was not used",
        "use --model matcher, which works with any laser",
    ),
    "gap": Cause(
        "scans are missing; a network that measures residual motions compared the scans at both ends of the "
        "gap, another network repeated the last motion",
        "find out why the recording lost scans; --model matcher matches across gaps as well",
    ),
    "slow scans": Cause(
        "the time between scans is longer than in the network's training",
        "use every scan (no --every), or --model matcher",
    ),
    "fast scans": Cause(
        "the time between scans is shorter than in the network's training",
        "use fewer scans (--every), or --model matcher",
    ),
    "beam count": Cause(
        "the number of beams changed",
        "nothing, if the laser's settings were changed on purpose",
    ),
    "no estimate": Cause(
        "the network gave no finite numbers; the last motion was repeated",
        "use --model matcher there",
    ),
}
"""By the cause, the text before the colon in a note of ``degraded``."""


def explain(cause: str, notes: str = "") -> Cause:
    """Explains a cause; one that is not in the table, of a model from another package, by its own note.

    Args:
        cause: text before the colon in a note.
        notes: ``degraded`` of the first pose that is marked for this cause.
    """
    own = next((note for note in notes.split("; ") if note.startswith(f"{cause}:")), "")
    return CAUSES.get(cause) or Cause(own.partition(": ")[2], "see the documentation of the model")
