"""Gradient steps of sheeprl's DreamerV2 at the sizes of `dreamer_v2.py --size m`, timed; prints steps per second as JSON.

It needs an older Gymnasium, and so an environment of its own:

python -m venv PEER && PEER/bin/pip install sheeprl==0.5.7 "numpy<2" "setuptools<80"
PEER/bin/python benchmark/sheeprl_dreamer.py

Its dreams are differentiated even where REINFORCE, its default as ours, gives those gradients a weight of 0; ours are not. Its steps
are on data that lies ready; ours draw theirs from the replay.
"""

import time

import gymnasium as gym
import hydra
import torch
from lightning.fabric import Fabric
from sheeprl.algos.dreamer_v2.agent import build_agent
from sheeprl.algos.dreamer_v2.dreamer_v2 import train
from sheeprl.utils.utils import dotdict
from timing import report

SECONDS, WARM_UP = 8.0, 4  # of gradient steps, and gradient steps before
ACTIONS, SIDE = 3, 64
SIZES = {  # sheeprl's names for the sizes, the activation and a discount head; REINFORCE is its default
    "algo.per_rank_batch_size": 16,
    "algo.per_rank_sequence_length": 50,
    "algo.horizon": 15,
    "algo.dense_units": 200,
    "algo.mlp_layers": 4,
    "algo.dense_act": "torch.nn.SiLU",
    "algo.cnn_act": "torch.nn.SiLU",
    "algo.world_model.encoder.cnn_channels_multiplier": 16,
    "algo.world_model.recurrent_model.recurrent_state_size": 200,
    "algo.world_model.transition_model.hidden_size": 200,
    "algo.world_model.representation_model.hidden_size": 200,
    "algo.world_model.use_continues": True,
}


def make_config() -> dotdict:
    with hydra.initialize_config_module("sheeprl.configs", version_base="1.3"):
        overrides = ["exp=dreamer_v2", "env=dummy", *(f"{name}={value}" for name, value in SIZES.items())]
        return dotdict(hydra.compose("config", overrides))


def make_batch(length: int, games: int) -> dict[str, torch.Tensor]:
    """Frames, actions and ends as its replay gives them; what they show does not matter to the clock."""
    zeros = torch.zeros(length, games, 1)
    actions = torch.nn.functional.one_hot(torch.randint(ACTIONS, (length, games)), ACTIONS).float()
    frames = torch.randint(256, (length, games, 3, SIDE, SIDE)).float()
    flags = {name: zeros.clone() for name in ("rewards", "terminated", "truncated", "is_first")}
    return {"rgb": frames, "actions": actions, **flags}


def main() -> None:
    torch.manual_seed(1)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    cfg, fabric = make_config(), Fabric(accelerator="cpu", devices=1)
    # as its command does
    torch.distributions.Distribution.set_default_validate_args(cfg.distribution.validate_args)
    torch.set_float32_matmul_precision(cfg.float32_matmul_precision)
    space = gym.spaces.Dict({"rgb": gym.spaces.Box(0, 255, (3, SIDE, SIDE), "uint8")})
    world_model, *others = build_agent(fabric, [ACTIONS], False, cfg, space)
    modules = {"world_model": world_model, "actor": others[0], "critic": others[1]}
    optimizers = [
        hydra.utils.instantiate(cfg.algo[name].optimizer, params=module.parameters(), _convert_="all")
        for name, module in modules.items()
    ]
    optimizers = fabric.setup_optimizers(*optimizers)
    data = make_batch(cfg.algo.per_rank_sequence_length, cfg.algo.per_rank_batch_size)

    def step() -> None:
        train(fabric, world_model, *others[:3], *optimizers, data, None, cfg, [ACTIONS])

    for _ in range(WARM_UP):
        step()
    begin, steps = time.perf_counter(), 0
    while time.perf_counter() - begin < SECONDS or steps < 2:
        step()
        steps += 1
    report(steps / (time.perf_counter() - begin))


if __name__ == "__main__":
    main()
