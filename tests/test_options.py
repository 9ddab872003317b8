"""Options against their dataclass."""

from dataclasses import dataclass
from typing import Optional

import pytest

from rcnn_odom.errors import InputError
from rcnn_odom.options import check_options, option


@dataclass(kw_only=True)
class Inner:
    size: int = option(least=1)


@dataclass(kw_only=True)
class Outer:
    inner: Inner
    flag: bool
    rate: float = option(above=0, below=1)
    words: str = option(choices=("yes", "no"))
    limit: int | None = option(above=0)
    old: Optional[int] = option(above=0, default=3)  # noqa: UP045


GOOD = {"inner": {"size": 2}, "flag": True, "rate": 0.5, "words": "no", "limit": None}


def test_good_ones_pass_and_defaults_are_filled_in():
    values = dict(GOOD)
    check_options(Outer, values, "group.")
    assert values == GOOD | {"old": 3}
    check_options(Outer, GOOD | {"old": None, "limit": 7}, "group.")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inner": {"size": 0}}, "group.inner.size=0: must be a whole number from 1"),
        ({"inner": 3}, "group.inner=3: is a group; set its members, for instance group.inner.size="),
        ({"flag": 1}, "group.flag=1: must be true or false"),
        ({"rate": 1.0}, "group.rate=1.0: must be a number above 0 and below 1"),
        ({"rate": float("nan")}, "group.rate=nan: must be a number"),
        ({"rate": True}, "group.rate=True: must be a number"),
        ({"words": "perhaps"}, "group.words=perhaps: choose one of yes, no"),
        ({"limit": 1.5}, "group.limit=1.5: must be null or a whole number above 0"),
        ({"old": 0}, "group.old=0: must be null or a whole number above 0"),
        ({"nothing": 1}, "group.nothing: there is no such option; there are flag, inner"),
    ],
)
def test_bad_ones_are_told_in_a_line(change, message):
    with pytest.raises(InputError) as refused:
        check_options(Outer, GOOD | change, "group.")
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_missing_one_is_named():
    with pytest.raises(InputError, match=r"group\.flag is missing"):
        check_options(Outer, {name: value for name, value in GOOD.items() if name != "flag"}, "group.")


def test_before_all_are_known_some_may_be_missing_or_refer_to_others():
    check_options(Outer, {"rate": "${other.rate}", "stranger": 1}, "group.", partly=True)
    with pytest.raises(InputError, match="must be a number"):
        check_options(Outer, {"rate": 3}, "group.", partly=True)
