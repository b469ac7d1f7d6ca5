"""Plants, the box of their designs, and their exact discretisation."""
