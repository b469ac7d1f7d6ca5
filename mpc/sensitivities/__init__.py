"""Changes of controllers with their first state and parameters: LQR, linear MPC, and what nonlinear MPC shares."""
