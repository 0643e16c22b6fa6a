"""The commands of `arm-companion`, one module each."""
