"""A prior weight that is inferred, not descended to: how probable it is that the advice is right."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor
from torch import distributions as d

from torchrl_priors.functional import alignment, categorical_log_prob_std, gaussian_log_prob_std
from torchrl_priors.objectives.cross_entropy import cross_entropy

__all__ = ["PriorTrust", "advice_evidence"]

_CATEGORICAL = (d.Categorical, d.OneHotCategorical)


def advice_evidence(
    advantage: Tensor, prior_log_prob: Tensor, dist: d.Distribution, prior_dist: d.Distribution
) -> Tensor:
    r"""What each step of a rollout says for or against the prior, :math:`y = \hat A\, x`. Beyond the paper.

    :math:`\hat A` is the advantage on raw rewards, standardised over the rollout and clipped to :math:`\pm 5`, and

    .. math:: x = \frac{\log\pi_0(a|s) + H^X_s(\pi\|\pi_0)}{\mathrm{std}_{a\sim\pi}[\log\pi_0(a|s)]}

    how much the prior prefers the action to what the student does on average. Under the student :math:`x` has mean 0
    and variance 1 in every state, so :math:`\mathbb E[y|s]` is the slope of the advantage towards the advice: a
    correlation, whatever the scales of rewards and of log-densities.

    Args:
        advantage (Tensor): ``[*B, 1]``, of a whole rollout.
        prior_log_prob (Tensor): :math:`\log\pi_0(a|s)`, ``[*B, 1]``.
        dist, prior_dist (torch.distributions.Distribution): of student and prior, ``[*B]``; both categorical, or both
            diagonal Gaussians (:class:`~torch.distributions.Independent` of :class:`~torch.distributions.Normal`).

    Returns:
        Tensor: ``[*B, 1]``. 0 where the prior prefers nothing.

    Raises:
        NotImplementedError: distributions of another kind.

    Examples:
        >>> from torch.distributions import Categorical
        >>> student, prior = Categorical(torch.ones(2, 2)), Categorical(torch.tensor([[3.0, 1.0], [3.0, 1.0]]))
        >>> chosen = prior.log_prob(torch.tensor([0, 1])).unsqueeze(-1)
        >>> advice_evidence(torch.tensor([[1.0], [-1.0]]), chosen, student, prior).squeeze(-1).sign()
        tensor([1., 1.])
    """
    std = _log_prob_std(dist, prior_dist).unsqueeze(-1)
    preference = alignment(prior_log_prob, cross_entropy(dist, prior_dist).unsqueeze(-1))
    preference = torch.where(std > 0, preference / std, torch.zeros_like(std))
    standardised = (advantage - advantage.mean()) / advantage.std(correction=0).clamp_min(1e-6)
    return standardised.clamp(-5, 5) * preference


def _log_prob_std(dist: d.Distribution, prior_dist: d.Distribution) -> Tensor:
    if isinstance(dist, _CATEGORICAL) and isinstance(prior_dist, _CATEGORICAL):
        return categorical_log_prob_std(dist.logits, prior_dist.logits)
    if isinstance(dist, d.Independent) and isinstance(prior_dist, d.Independent):
        base, prior = dist.base_dist, prior_dist.base_dist
        if isinstance(base, d.Normal) and isinstance(prior, d.Normal):
            return gaussian_log_prob_std(base.loc, base.scale, prior.loc, prior.scale)
    raise NotImplementedError(
        "Evidence needs two categorical distributions or two diagonal Gaussians, got"
        f" {type(dist).__name__} and {type(prior_dist).__name__}."
    )


class PriorTrust(TensorDictModuleBase):
    r"""A prior weight that listens before it trusts: :math:`\omega(s) = P(\text{the advice is right at } s)`.

    Beyond the paper. For its first ``listen`` frames the weight is 0: the student learns as if alone, and what it does
    is evidence about the teacher, while student and teacher still disagree and exploration is wide. The evidence
    :math:`y` of each step (:func:`advice_evidence`) is regressed on the state by Bayesian linear regression on random
    features, :math:`y = \phi(s)^\top w + \epsilon` with :math:`w\sim N(0, \tau^2 I)`. With the posterior
    :math:`w\sim N(m, \Sigma)`,

    .. math:: \omega(s) = P(\phi(s)^\top w > 0) = \Phi\!\left(\frac{\phi(s)^\top m}
        {\sqrt{\phi(s)^\top\Sigma\,\phi(s)}}\right).

    Then it decides, once: if the mean of :math:`\omega` over the states of the second half of the listening is below
    ``min_trust`` the prior is dropped for good, else :math:`\omega` is used as it is from then on. Imitating advice
    that is right in one state and wrong in the next can be worse than ignoring it, which is why the decision is joint;
    and a student that imitates produces no more evidence, which is why it is final.

    It goes where a :class:`~torchrl_priors.PriorWeight` goes, in a loss with ``weight_target="none"``; it has no
    parameters, all it knows is in buffers and so in ``state_dict``.

    Args:
        num_features (int): of the entry it reads, ``[*B, num_features]``, about standardised.

    Keyword Args:
        listen (int): frames to listen to. Defaults to 49152.
        min_trust (float): in [0, 1]. Defaults to 0.65; calibrated, see ``results/mujoco``.
        num_random (int): tanh features beside the linear ones and the constant. Defaults to 64.
        prior_std (float): :math:`\tau`. Defaults to 0.05.
        seed (int): of the random features. Defaults to 0.
        in_keys (list of NestedKey, optional): one entry. Defaults to ``["observation"]``.
        out_keys (list of NestedKey, optional): one entry, ``[*B, 1]``. Defaults to ``["prior_weight"]``.

    Raises:
        ValueError: a number is out of its range, or there is more than one key.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> trust = PriorTrust(2, listen=4000)
        >>> states = torch.randn(4000, 2)
        >>> trust.update(states, 0.3 + torch.randn(4000, 1))  # advice that is right everywhere
        >>> trust.decided, bool(trust.mean_trust > 0.9)
        (True, True)
        >>> weight = trust(TensorDict(observation=states, batch_size=[4000]))["prior_weight"]
        >>> weight.shape, bool(weight.mean() > 0.9)
        (torch.Size([4000, 1]), True)
    """

    def __init__(
        self,
        num_features: int,
        *,
        listen: int = 49_152,
        min_trust: float = 0.65,
        num_random: int = 64,
        prior_std: float = 0.05,
        seed: int = 0,
        in_keys: list[NestedKey] | None = None,
        out_keys: list[NestedKey] | None = None,
    ) -> None:
        super().__init__()
        self.in_keys = ["observation"] if in_keys is None else list(in_keys)
        self.out_keys = ["prior_weight"] if out_keys is None else list(out_keys)
        if len(self.in_keys) != 1 or len(self.out_keys) != 1:
            raise ValueError(f"One entry in, one out: got in_keys={self.in_keys} and out_keys={self.out_keys}.")
        for name, number in (("num_features", num_features), ("num_random", num_random), ("listen", listen)):
            if number < 1:
                raise ValueError(f"{name} must be at least 1, got {number}.")
        if not 0 <= min_trust <= 1:
            raise ValueError(f"min_trust must be in [0, 1], got {min_trust}.")
        if not prior_std > 0:
            raise ValueError(f"prior_std must be positive, got {prior_std}.")
        self.listen, self.min_trust, self.prior_std = listen, min_trust, prior_std
        generator = torch.Generator().manual_seed(seed)
        size = num_random + num_features + 1
        self.register_buffer("projection", torch.randn(num_features, num_random, generator=generator))
        self.register_buffer("phase", torch.randn(num_random, generator=generator))
        # sums over the evidence: of phi phi', phi y, y and y^2
        self.register_buffer("gram", torch.zeros(size, size, dtype=torch.float64))
        self.register_buffer("moment", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("sums", torch.zeros(2, dtype=torch.float64))
        self.register_buffer("frames", torch.zeros((), dtype=torch.long))
        self.register_buffer("states", torch.zeros(listen - listen // 2, num_features))  # of the second half
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("covariance", torch.eye(size) * prior_std**2)
        self.register_buffer("mean_trust", torch.tensor(float("nan")))

    @property
    def decided(self) -> bool:
        """Whether the listening is over."""
        return bool(self.frames >= self.listen)

    @torch.no_grad()
    def update(self, observation: Tensor, evidence: Tensor) -> None:
        """Listen to a rollout; nothing once it is decided.

        Args:
            observation (Tensor): what ``in_keys`` names, ``[*B, num_features]``.
            evidence (Tensor): of :func:`advice_evidence`, ``[*B, 1]``.
        """
        if self.decided:
            return
        states, evidence = observation.reshape(-1, observation.shape[-1]), evidence.reshape(-1).double()
        seen, left = int(self.frames), self.listen - int(self.frames)
        states, evidence = states[:left], evidence[:left]
        features = self._features(states).double()
        self.gram += features.T @ features
        self.moment += features.T @ evidence
        self.sums += torch.stack([evidence.sum(), evidence.square().sum()])
        self.frames += len(states)
        start = seen - self.listen // 2  # in the buffer of states
        late = states[max(0, -start) :]
        self.states[max(0, start) : max(0, start) + len(late)] = late.to(self.states.dtype)
        if self.decided:
            self._decide()

    def _decide(self) -> None:
        variance = (self.sums[1] - self.sums[0].square() / self.frames) / self.frames
        precision = torch.diag_embed(torch.full_like(self.moment, self.prior_std**-2))
        covariance = torch.linalg.inv(self.gram / variance.clamp_min(1e-12) + precision)
        self.mean.copy_(covariance @ self.moment / variance.clamp_min(1e-12))
        self.covariance.copy_(covariance)
        self.mean_trust.copy_(self._trust(self.states).mean())

    def _features(self, states: Tensor) -> Tensor:
        width, count = states.shape[-1] ** 0.5, self.projection.shape[-1] ** 0.5
        random = torch.tanh(states @ self.projection / width + self.phase) / count
        return torch.cat([random, states.clamp(-3, 3) / width, torch.ones_like(states[..., :1])], -1)

    def _trust(self, states: Tensor) -> Tensor:
        features = self._features(states)
        variance = ((features @ self.covariance) * features).sum(-1, keepdim=True)
        return torch.special.ndtr((features @ self.mean).unsqueeze(-1) / variance.clamp_min(1e-12).sqrt())

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the weight ``[*B, 1]``: 0 before the decision, and after it if it went against the prior."""
        trust = self._trust(tensordict.get(self.in_keys[0]))
        trusted = self.mean_trust >= self.min_trust  # never, while it is NaN
        return tensordict.set(self.out_keys[0], torch.where(trusted, trust, torch.zeros_like(trust)))
