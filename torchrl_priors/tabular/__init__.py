"""The paper's tabular study: Q-learning teachers, their degradations, and actor-critic students, in one batch."""

from torchrl_priors.tabular.actor_critic import LOG_FIELDS, Hyper
from torchrl_priors.tabular.advice import advice_tables, parse_prior, sample_degraded
from torchrl_priors.tabular.q_learning import TeacherHyper, evaluate_greedy
from torchrl_priors.tabular.snapshots import WeightHistory, weight_history
from torchrl_priors.tabular.study import StudentConfig, runs_of, train_students, train_teachers

__all__ = [
    "LOG_FIELDS",
    "Hyper",
    "StudentConfig",
    "TeacherHyper",
    "WeightHistory",
    "advice_tables",
    "evaluate_greedy",
    "parse_prior",
    "runs_of",
    "sample_degraded",
    "train_students",
    "train_teachers",
    "weight_history",
]
