"""A small game in pixels, with every entry under nested keys; ``pixels.py`` plays it.

A ball falls from a random column, straight down; the paddle moves left, stays or moves right. The last step pays 1 if
the ball is caught, else -1.
"""

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase


class Catch(EnvBase):
    """A batch of games of ``size`` steps: pixels ``[games, 1, size, size]``, and the columns of ball and paddle."""

    def __init__(self, games, size=7):
        super().__init__(batch_size=[games])
        self.size = size
        self.rng = torch.Generator().manual_seed(0)
        self.observation_spec = self._agent(
            observation=Composite(
                pixels=Bounded(0.0, 1.0, shape=(games, 1, size, size)),
                columns=Unbounded(shape=(games, 2)),
                shape=[games],
            ),
        )
        self.action_spec = self._agent(action=Categorical(3, shape=(games,)))
        self.reward_spec = self._agent(reward=Unbounded(shape=(games, 1)))
        self.done_spec = self._agent(
            done=Binary(shape=(games, 1), dtype=torch.bool), terminated=Binary(shape=(games, 1), dtype=torch.bool)
        )
        self.row, self.ball, self.paddle = (torch.zeros(games, dtype=torch.long) for _ in range(3))

    def _agent(self, **specs):
        return Composite(agent=Composite(**specs, shape=self.batch_size), shape=self.batch_size)

    def _observe(self):
        pixels = torch.zeros(*self.batch_size, 1, self.size, self.size)
        games = torch.arange(len(self.ball))
        pixels[games, 0, self.row, self.ball] = 1.0
        pixels[games, 0, -1, self.paddle] = 1.0
        return {"pixels": pixels, "columns": torch.stack([self.ball, self.paddle], -1).float()}

    def _output(self, **entries):
        return TensorDict({"agent": {"observation": self._observe(), **entries}}, batch_size=self.batch_size)

    def _reset(self, tensordict):
        reset = None if tensordict is None else tensordict.get(("agent", "_reset"), None)
        reset = torch.ones_like(self.row, dtype=torch.bool) if reset is None else reset.squeeze(-1)
        for name in ("ball", "paddle"):
            column = torch.randint(self.size, self.row.shape, generator=self.rng)
            setattr(self, name, torch.where(reset, column, getattr(self, name)))
        self.row = torch.where(reset, 0, self.row)
        return self._output(done=torch.zeros_like(reset)[:, None], terminated=torch.zeros_like(reset)[:, None])

    def _step(self, tensordict):
        self.paddle = (self.paddle + tensordict["agent", "action"] - 1).clamp(0, self.size - 1)
        self.row = self.row + 1
        end = (self.row == self.size - 1)[:, None]
        caught = torch.where(self.ball == self.paddle, 1.0, -1.0)[:, None]
        return self._output(reward=end * caught, done=end, terminated=end.clone())

    def _set_seed(self, seed):
        self.rng = torch.Generator().manual_seed(0 if seed is None else seed)
