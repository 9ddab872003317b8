"""A sample of a stream in constant memory."""

import pytest

from rcnn_odom.deployment.sampling import EvenSample


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 16, 17, 1000])
def test_items_are_evenly_spaced_and_never_too_many(count):
    sample = EvenSample(8)
    for item in range(count):
        sample.add(lambda item=item: item)
    assert len(sample.items) <= 8
    assert sample.items[:1] == [0][:count]
    if count > 1:
        steps = {later - earlier for earlier, later in zip(sample.items, sample.items[1:], strict=False)}
        assert len(steps) == 1
        assert count - sample.items[-1] <= max(steps), "the end of the stream is in it"
    if count > 8:
        assert len(sample.items) >= 4
