"""The other projects that docstrings refer to."""

#: Where each documents its names. ``_inventories/`` holds the entries that are used: ``make inventories``.
URLS = {
    "torch": "https://docs.pytorch.org/docs/2.13/",
    "tensordict": "https://docs.pytorch.org/tensordict/0.14/",
    "torchrl": "https://docs.pytorch.org/rl/0.14/",
    "gymnasium": "https://gymnasium.farama.org/",
    "numpy": "https://numpy.org/doc/stable/",
    "matplotlib": "https://matplotlib.org/stable/",
}

#: Public names, and those that the project documents them under.
ALIASES = {
    "torch.distributions.Categorical": "torch.distributions.categorical.Categorical",
    "torch.distributions.Distribution": "torch.distributions.distribution.Distribution",
    "torch.distributions.MixtureSameFamily": "torch.distributions.mixture_same_family.MixtureSameFamily",
    "torch.nn.Parameter": "torch.nn.parameter.Parameter",
    "torchrl.envs.ActionScaling": "torchrl.envs.transforms.ActionScaling",
    "torchrl.envs.Compose": "torchrl.envs.transforms.Compose",
    "torchrl.envs.RewardSum": "torchrl.envs.transforms.RewardSum",
    "torchrl.modules.ProbabilisticActor": "torchrl.modules.tensordict_module.ProbabilisticActor",
}
