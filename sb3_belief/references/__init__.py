"""What the paper compares with that trains centrally: with the global state, all agents' actions, or shared weights."""
