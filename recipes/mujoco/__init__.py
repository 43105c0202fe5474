"""PPO with a teacher, on MuJoCo or any environment of Gymnasium: ``python -m recipes.mujoco``."""
