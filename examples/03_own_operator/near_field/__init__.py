"""An operator for mapstream in a package of its own."""
