"""`arm-companion doctor`: looks at an installation as it stands, and says what to mend. Nothing is changed."""
