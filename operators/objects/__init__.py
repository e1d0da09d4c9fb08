"""Objects: detected, described, tracked, mapped, and what people call them."""
