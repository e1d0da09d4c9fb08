"""All that flows between operators."""
