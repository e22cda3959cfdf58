"""What the paper compares with that is decentralised: one SB3 model for each agent, which learns from its own steps alone."""
