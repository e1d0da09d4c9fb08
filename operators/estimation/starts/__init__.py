"""Where the variables begin: a problem that begins badly ends badly."""
