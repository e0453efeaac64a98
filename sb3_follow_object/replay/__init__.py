"""The hindsight replay buffer and what it is made of; CHER's choice of batches."""
