"""Studies of the method on systems whose equations are known, so that its errors are too."""
