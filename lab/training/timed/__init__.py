"""Training by the clock, from arrays made beforehand, and its runs made small."""
