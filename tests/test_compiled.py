"""Where compiled code is kept, also where the package cannot be written."""

import pytest
from numba.core import caching

from rcnn_odom.compiled import compiled


def double(x):
    return 2 * x


def test_beside_a_package_that_cannot_be_written_the_users_folder_is_taken(monkeypatch, tmp_path):
    def refuse(self):
        raise PermissionError("read-only")

    monkeypatch.setattr(caching.InTreeCacheLocator, "ensure_cache_path", refuse)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    function = compiled(double)
    assert function(3) == 6
    assert list(tmp_path.glob("numba/*/*.nbi"))


def test_where_nothing_can_be_written_it_is_compiled_every_time(monkeypatch):
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    function = compiled(double)
    assert function(3) == 6
    assert function.stats.cache_hits == {}


def test_other_errors_are_not_hidden():
    def broken(**options):
        raise RuntimeError("another fault")

    with pytest.raises(RuntimeError, match="another fault"):
        compiled(double, broken)
