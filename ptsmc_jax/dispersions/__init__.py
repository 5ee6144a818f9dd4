"""What varies from trial to trial, and how it is drawn."""
