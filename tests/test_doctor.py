"""skylamp doctor: JSON to paste into a bug report."""

import json
import os

import skylamp as sl
from skylamp.app import doctor


def test_what_a_report_needs(tmp_path, monkeypatch):
    """Versions, every backend with its reason, caches that cannot be written, and nothing that is no JSON."""
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "file" / "cache"))
    found = json.loads(json.dumps(doctor.examined()))
    assert found["versions"]["numpy"] and found["versions"]["python"].startswith("3.")
    assert [info["name"] for info in found["backends"]] == [info.name for info in sl.backends()]
    assert found["machine"]["free"] > 0 and found["machine"]["cores"] == os.cpu_count()
    assert found["caches"]["pocl"]["exists"] is False and found["caches"]["pocl"]["writable"] is False
    assert found["environment"]["POCL_CACHE_DIR"]


def test_no_secret_of_the_environment_is_told(monkeypatch):
    """Only what concerns drivers and caches."""
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "x")
    assert "AWS_SECRET_ACCESS_KEY" not in doctor.examined()["environment"]
