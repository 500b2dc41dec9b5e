"""The closed loop inside ``learn()``: identify, accept, retrain, select."""
