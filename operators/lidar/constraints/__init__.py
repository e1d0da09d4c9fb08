"""Constraints from aligned clouds: between keyframes whose relative pose is roughly known."""
