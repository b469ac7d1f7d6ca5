"""Small linear studies with independent optima, and a runner that sends the whole loop over them."""
