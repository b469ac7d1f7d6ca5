"""Names that the loop writes into its results and the report reads."""

SOURCES = ("start", "design", "policy", "updates", "redesign")  # what a gain is due to, from LQR at the start design on
FORMER = "return to "  # begins the name of a proposal that was deployed before, or is the start
POLICY_ALONE = "its policy at the present design"
IDENTIFIED = "LQR, identified"  # by least squares from the logs that the twin has, with its offset
OFFSET_FREE = "MPC, offset-free"
NOT_IDENTIFIED = "no input stabilises the model that was identified: this is the passive plant"
TAKEN = ("passive", "LQR", "PID", "MPC", IDENTIFIED, OFFSET_FREE, "learned", "learned (sampled)", "learned, no filter")
