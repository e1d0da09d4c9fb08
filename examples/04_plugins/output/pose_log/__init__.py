"""An output of mapstream: a table of poses after each optimisation."""
