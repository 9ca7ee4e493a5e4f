"""The agent learns: a stated return on a small budget."""

import json

import pytest
from conftest import run

pytestmark = pytest.mark.slow


def evaluation(folder, *flags) -> float:
    run(*flags, "--compile", "--eval-episodes", 20, "--run-dir", "run", cwd=folder)
    return json.loads((folder / "run" / "evaluation.json").read_text())["mean"]


def test_inverted_pendulum_stands(tmp_path):
    """The most that an episode can give is 1,000."""
    assert evaluation(tmp_path, "--env-id", "kle/InvertedPendulum-v2", "--total-timesteps", 100_000) > 900


@pytest.mark.parametrize("mode", [[], ["--kle-stop"], ["--kle-rollback"]], ids=["ppo", "kle-stop", "kle-rollback"])
def test_hopper_hops(tmp_path, mode):
    """A policy that falls at once gets about 20, one that stands still 1,000."""
    assert evaluation(tmp_path, "--env-id", "kle/Hopper-v2", "--total-timesteps", 500_000, *mode) > 1500


def test_pendulum_swings_up_in_the_modern_setting(tmp_path):
    """Random play gets about -1,200; time-outs are bootstrapped, eight environments share the batch."""
    flags = ["--kle-rollback", "--update-epochs", 80, "--bootstrap-truncated", "--kl-estimator", "exact-old-new"]
    flags += ["--kl-samples", "batch", "--kl-timing", "after-iteration", "--rollback", "policy-moments"]
    flags += ["--num-envs", 8, "--gamma", 0.9, "--learning-rate", 1e-3]
    assert evaluation(tmp_path, "--env-id", "Pendulum-v1", "--total-timesteps", 300_000, *flags) > -400
