"""What goes round: optimize on a model, run the black box there, learn, again."""
