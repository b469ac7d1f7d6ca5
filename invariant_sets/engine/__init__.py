"""The recursion behind every invariant set, in coordinates that suit the arithmetic."""
