"""Arrays in, arrays out: nothing here knows a run or a model."""
