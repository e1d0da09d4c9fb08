"""Images before anything is found in them: contrast, depth of bits, size, lens, and what each needs of its camera."""
