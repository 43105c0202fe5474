"""PPO on MuJoCo with a teacher: ``python -m recipes.mujoco``."""
