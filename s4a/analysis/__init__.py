"""What is done with a registered collection (6): statistics, the model, transfer."""
