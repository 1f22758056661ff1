"""Damaged logs of real hardware: each a clear error or a named warning, and no traceback."""

import importlib.util
import os
import sys
from pathlib import Path

import pytest
from conftest import needs_examples

from simopt_envs.measured import inspect_log

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "simopt_envs" / "measured" / "examples"
sys.path.append(str(ROOT / "benchmarks"))
from damaged_logs import write_damaged_logs  # noqa: E402

pytestmark = [
    needs_examples,
    pytest.mark.skipif(
        not os.environ.get("SIMOPT_DATA") or importlib.util.find_spec("yaml") is None,
        reason="needs pyyaml and the recordings that SIMOPT_DATA names",
    ),
]


def test_no_damage_passes_in_silence(tmp_path):
    logs = list(write_damaged_logs(Path(os.environ["SIMOPT_DATA"]), tmp_path))
    assert len(logs) >= 50
    silent = []
    for log in logs:
        inspection = inspect_log(log.path, EXAMPLES / f"{log.example}.xml", EXAMPLES / f"{log.example}.yaml")
        found = [finding for findings in inspection.findings.values() for finding in findings]
        assert all(finding.message for finding in found)
        if not found:
            silent.append(log.path.stem)
    assert silent == []
