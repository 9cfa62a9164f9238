"""Networks by name, in torch; running a trained model does not need them."""
