"""Networks and their training, in torch; running a trained model does not need this package."""
