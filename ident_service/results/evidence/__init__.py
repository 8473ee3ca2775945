"""What a report draws that `parameters.json` does not say: made once, kept beside it, checked when it is read."""
