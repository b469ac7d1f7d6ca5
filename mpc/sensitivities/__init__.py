"""How controllers change with their first state and with parameters: LQR, linear MPC, and what nonlinear MPC shares."""
