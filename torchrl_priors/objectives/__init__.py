"""Losses that learn from soft action priors."""

from __future__ import annotations

from .cross_entropy import cross_entropy, has_analytic_cross_entropy

__all__ = ["cross_entropy", "has_analytic_cross_entropy"]
