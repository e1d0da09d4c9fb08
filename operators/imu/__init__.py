"""Inertial measurement units: their parameters, and the biases they start with."""
