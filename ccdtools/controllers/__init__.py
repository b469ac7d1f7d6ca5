"""Controllers, learned and classical: anything with ``u = controller(x)``, batched."""
