"""What is optimal or learnt, in the files of other programs."""
