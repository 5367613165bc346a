"""Which versions stand beside a result."""

import pytest

from sdfnet.data import versions as versions_module
from sdfnet.data.versions import RECORDED_PACKAGES, versions


def test_versions_are_of_python_and_of_all_packages_that_are_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(versions_module, "OPTIONAL_PACKAGES", ("libigl", "not-installed-anywhere"))
    assert set(versions()) == {"python", *RECORDED_PACKAGES, "libigl"}
