"""Qwen2.5-VL of real sizes: fine-tuned on prompts that the crate wrote, into an adapter that the crate loads."""
