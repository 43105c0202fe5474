"""Fast collection from vectorised Gymnasium environments, and their evaluation.

Importing this package needs neither Gymnasium nor MuJoCo: only :func:`make_vector_env` and the saving of physical
states do.
"""

from torchrl_priors.collectors.env_state import env_state_dict, load_env_state_dict
from torchrl_priors.collectors.evaluation import Evaluation, evaluate
from torchrl_priors.collectors.running_norm import RunningNorm
from torchrl_priors.collectors.vector_collector import VectorCollector
from torchrl_priors.collectors.vector_env import make_vector_env

__all__ = [
    "Evaluation",
    "RunningNorm",
    "VectorCollector",
    "env_state_dict",
    "evaluate",
    "load_env_state_dict",
    "make_vector_env",
]
