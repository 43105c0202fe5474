"""A trainer from a YAML file: ``from_yaml.yaml`` names this library's configs beside TorchRL's own.

The student swings a pendulum up, with the bot of ``ppo.py`` as its teacher.

    python examples/from_yaml.py
    python examples/from_yaml.py method=e2r
"""

import hydra
import torch
from tensordict.nn import TensorDictModule
from torchrl.modules import IndependentNormal, ProbabilisticActor

import torchrl_priors


def swing_up(observation):
    """The bot of ``ppo.py``: mean and spread of its torque."""
    cos, sin, speed = observation.unbind(-1)
    energy = 0.5 * speed**2 + 15 * (cos - 1)
    torque = torch.where(cos > 0.9, -8 * sin - 2 * speed, -0.05 * speed * energy)
    loc = torque.clamp(-2, 2).unsqueeze(-1)
    return loc, torch.ones_like(loc)


def make_teacher():
    """What the YAML file names: the bot as a policy."""
    module = TensorDictModule(swing_up, in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(module, in_keys=["loc", "scale"], distribution_class=IndependentNormal)


@hydra.main(version_base="1.3", config_path=".", config_name="from_yaml")
def main(config):
    """Builds the trainer and trains."""
    torch.manual_seed(0)
    trainer = hydra.utils.instantiate(config.trainer)

    def report(batch):
        returns = batch["next", "episode_reward"][batch["next", "done"]]
        print(f"{trainer.collected_frames:6d} frames, return {returns.mean():6.0f}", flush=True)

    trainer.register_op("pre_steps_log", report)
    trainer.train()


if __name__ == "__main__":
    torchrl_priors.register_configs()
    main()
