"""Poses that something outside of the robot measured."""
