"""What the arm and the vehicle do: pure step functions over transition tables."""
