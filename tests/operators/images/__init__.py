"""Images before anything is found in them."""
