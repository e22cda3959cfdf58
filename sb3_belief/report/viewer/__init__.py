"""The belief viewer: one HTML page with recorded episodes, and what the agents believed of each other at each step."""
