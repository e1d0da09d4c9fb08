"""Objects as landmarks: one for each thing, with its class, place and extent."""
