"""One page of a recorded flight, for the evening after."""
