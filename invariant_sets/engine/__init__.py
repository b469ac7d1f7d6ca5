"""Recursion behind every invariant set, in well-scaled coordinates."""
