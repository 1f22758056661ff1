"""The README's Python runs as printed, from top to bottom; where it trains for minutes, with fewer steps."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from conftest import needs_batch
from gap_plant import MODEL, record

README = Path(__file__).parents[1] / "README.md"
FEWER_STEPS = {  # text in a block marked "tests: fewer steps" -> what is run
    "trainer=TorchPPO()": "trainer=TorchPPO(PPOConfig(num_envs=4, num_steps=5, iterations=1, warm_start_iterations=1))",
    "iterations=3": "iterations=1",
    "real_system=robot": "real_system=robot, simulated_rollouts=12, evaluation_episodes=2, updates_per_iteration=1",
    "import TorchPPO": "import PPOConfig, TorchPPO",
}


def python_blocks():
    text = README.read_text()
    for marked, code in re.findall(r"(<!-- tests: fewer steps -->\n)?```python\n(.*?)```", text, flags=re.S):
        if marked:
            for printed, run in FEWER_STEPS.items():
                assert code.count(printed) == 1
                code = code.replace(printed, run)
        yield code


@needs_batch
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_blocks_run(capsys, tmp_path, monkeypatch):
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    Path("arm.xml").write_text(MODEL)
    for i, recording in enumerate(
        record(lambda q, v: np.array([0.0, -0.4 * np.tanh(v[1] / 0.01)]), np.random.default_rng(1))
    ):
        recording.save(f"run_{i + 1}.csv")
    scope = {}
    for code in python_blocks():
        exec(compile(code, "README.md", "exec"), scope)
    out = capsys.readouterr().out
    assert "drawer_damping = 35 N s/m" in out
    assert "coulomb_friction at joint:elbow: frictionloss 0.4" in out
    assert len(re.findall(r"^[01]\.\d+ \[", out, re.MULTILINE)) == 2  # two iterations were printed

    trainer, robot = scope["HillClimbing"](), scope["Robot"](gym.make("SimOpt/Drawer-v0"))
    loop = scope["SimOpt"](
        "SimOpt/Drawer-v0", scope["Gaussian"].around_nominal(scope["xi"], 0.02), trainer, robot, simulated_rollouts=12
    )
    (first,) = loop.run(0)
    assert len(first.real) == 3
    assert np.isfinite(first.costs).all()
    assert set(scope["info"]["parameters"]) == {*scope["hopper"].parameters.names}


def test_links_within_the_repository_exist():
    for target in re.findall(r'(?:\]\(|src=")(?!https?://)([^)"#]+)', README.read_text()):
        assert (README.parent / target).exists(), target


def test_commands_exist():
    text = README.read_text()
    commands = set(re.findall(r"simopt-envs (\w+)", text))
    pytest.importorskip("tyro")
    from baselines import cli

    source = Path(cli.__file__).read_text()
    assert commands
    for command in commands:
        assert command.capitalize() in source, command
