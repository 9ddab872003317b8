"""What a pose may suffer from, in words for people: what happened, and what to do about it."""

from typing import NamedTuple


class Cause(NamedTuple):
    """One kind of trouble.

    Attributes:
        happened: what it was, and what became of the step.
        advice: what to do.
    """

    happened: str
    advice: str


HELP_MATCHER = (
    "give the wheels' odometry if there is one (--wheels, --odom-topic); in a tunnel try --model fused"
)

CAUSES = {
    "no returns": Cause(
        "nothing came back, or nothing of use; the last motion went on",
        "see whether something covered the laser or all walls were out of its range",
    ),
    "few returns": Cause(
        "too little came back; the matcher let the last motion go on, a network used what there was",
        f"see what was around the robot there; {HELP_MATCHER}",
    ),
    "no match": Cause(
        "the scan does not fit what was seen before; the last motion went on",
        f"use every scan (no --every); {HELP_MATCHER}",
    ),
    "new map": Cause(
        "six scans in a row did not fit, so that a new map began",
        "do not trust how the path before is joined to the path after it",
    ),
    "held": Cause(
        "nothing seen determines the motion along a direction, as in a bare corridor; the last motion went "
        "on along it",
        f"do not trust the distance there; {HELP_MATCHER}",
    ),
    "poor match": Cause(
        "much of the scan does not fit: people, a door that opens, a new room; the match stands",
        "nothing, unless walls are doubled in the map",
    ),
    "sudden motion": Cause(
        "half a metre or 20 degrees away from where the last motion led; the match stands",
        "see whether scans are missing or the robot was pushed; if neither, the match may be wrong",
    ),
    "ambiguous": Cause(
        "the scan fits in two places nearly as well; the better one was taken",
        f"look for doubled walls in the map; {HELP_MATCHER}",
    ),
    "no prior": Cause(
        "the network had no step; scan matching went on alone",
        "choose a --network that was trained for such a laser",
    ),
    "late scan": Cause(
        "the stamp is not after the one before; the scan was passed over",
        "stamp scans when they are measured, and record them in their order",
    ),
    "clock set": Cause(
        "the stamps jumped by more than ten seconds; no motion was added",
        "take the path before and after it for two drives",
    ),
    "to and fro": Cause(
        "each step takes the one before it back, as where two lasers write to one topic",
        "give each laser a topic of its own, and choose one with --topic",
    ),
    "other frame": Cause(
        "a scan of another frame_id, as of another laser; it was passed over",
        "choose the topic of one laser with --topic",
    ),
    "new frame": Cause(
        "the laser's frame_id changed for good; no motion was added",
        "take the path before and after it for two drives",
    ),
    "other laser": Cause(
        "the beams do not lie where the network knows them; the scan was not used",
        "take --model matcher, which fits any laser",
    ),
    "gap": Cause(
        "scans are missing; the last motion went on over the gap",
        "find out why the recording lost scans; --model matcher matches across gaps",
    ),
    "slow scans": Cause(
        "more time between scans than in the network's training",
        "use every scan (no --every), or take --model matcher",
    ),
    "fast scans": Cause(
        "less time between scans than in the network's training",
        "use fewer scans (--every), or take --model matcher",
    ),
    "beam count": Cause(
        "another number of beams than before",
        "nothing, if the laser's settings were changed on purpose",
    ),
    "no estimate": Cause(
        "the network gave no number; the last motion went on",
        "take --model matcher there",
    ),
}
"""By the kind that stands before the colon in ``degraded``."""


def explain(cause: str, words: str = "") -> Cause:
    """What is known of a kind of trouble; of one that another package adds, its own words.

    Args:
        cause: the kind.
        words: of the first pose that suffers from it.
    """
    own = next((note for note in words.split("; ") if note.startswith(f"{cause}:")), "")
    return CAUSES.get(cause) or Cause(own.partition(": ")[2], "see the documentation of the model")
