#!/usr/bin/env python3
"""Writes tests/fixtures/chat.json: conversations, and the text and ids that the reference's processor makes of them.

    pip install -r tests/reference/requirements.txt
    python tests/reference/make_chat.py TOKENIZER [FILE]

TOKENIZER is a directory with the published `tokenizer.json`, `tokenizer_config.json`, `chat_template.json` and
`preprocessor_config.json`; none of them is written to FILE. A part of a message is a text or the [height, width] of an
image; `tokens` is the number of ids of each image.
"""

import json
import pathlib
import sys

from PIL import Image
from transformers import AutoTokenizer
from transformers.models.qwen2_5_vl.processing_qwen2_5_vl import Qwen2_5_VLProcessor
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil
from transformers.models.qwen2_vl.video_processing_qwen2_vl import Qwen2VLVideoProcessor

IMAGE_ID = 151655
LONG = " ".join(f"{i}) Pixel ({i * 37 % 640},{i * 53 % 480}) lies {i * 0.173:.3f} m away;\n" for i in range(160))
CONVERSATIONS = {
    "default system, image before the text": [("user", [[60, 90], "How far is the door?"])],
    "default system, image after the text": [("user", ["How far is the door?", [90, 60]])],
    "no image": [("user", ["What is the metric depth of a photograph?"])],
    "custom system": [("system", ["You measure distances. Answer in metres."]), ("user", [[480, 640], "4.230?"])],
    "empty system, empty text": [("system", [""]), ("user", [[28, 28], ""])],
    "several images": [("user", [[60, 90], [112, 56], "Which of the two is nearer, ", [57, 59], " or this?"])],
    "numbered images": [("user", ["First: ", [60, 90], "then: ", [84, 84], "?"])],
    "unicode": [("user", ["  \u00c5ngstr\u00f6m, A\u030angstro\u0308m, \u8ddd\u79bb\u662f\u591a\u5c11\uff1f \u05d2\u05d0 \U0001f469\u200d\U0001f680\u2026\n\n\t", [56, 84], "\u0e02\u0e35\u0e48 \u00b12 \u00b5m\r\n"])],
    "very long": [("user", [[60, 90], LONG])],
    "two turns": [
        ("user", [[60, 90], "How far is the door?"]),
        ("assistant", ["It is 3.2 meters away."]),
        ("user", ["And the window?\n"]),
    ],
    "two turns with images and numbers": [
        ("system", ["S"]),
        ("user", [[60, 90], "this"]),
        ("assistant", [" 1.5"]),
        ("user", ["and ", [90, 60], "this"]),
    ],
    "special tokens in the text": [("user", [[60, 90], "<|im_end|>\n<tool_call>x</tool_call> <|object_ref_start|> <|image|>"])],
}
NUMBERED = {"numbered images", "two turns with images and numbers"}


def processor_of(directory):
    """Resizes by Pillow, not by torchvision, the default of 5; the sizes are the same."""
    template = json.loads((directory / "chat_template.json").read_text())["chat_template"]
    return Qwen2_5_VLProcessor(
        image_processor=Qwen2VLImageProcessorPil.from_pretrained(directory),
        tokenizer=AutoTokenizer.from_pretrained(directory),
        video_processor=Qwen2VLVideoProcessor(),
        chat_template=template,
    )


def message(role, parts):
    content = [
        {"type": "text", "text": p} if isinstance(p, str) else {"type": "image", "image": Image.new("RGB", p[::-1])}
        for p in parts
    ]
    return {"role": role, "content": content}


def main():
    directory = pathlib.Path(sys.argv[1])
    out = pathlib.Path(sys.argv[2] if len(sys.argv) > 2 else pathlib.Path(__file__).parents[1] / "fixtures/chat.json")
    processor, made = processor_of(directory), []
    for name, turns in CONVERSATIONS.items():
        messages = [message(role, parts) for role, parts in turns]
        options = {"add_generation_prompt": True, "add_vision_id": name in NUMBERED}
        text = processor.apply_chat_template(messages, tokenize=False, **options)
        images = [c["image"] for m in messages for c in m["content"] if "image" in c]
        inputs = processor(text=[text], images=images or None)
        ids = [int(i) for i in inputs["input_ids"][0]]
        tokens = [int(t * h * w) // 4 for t, h, w in inputs.get("image_grid_thw", [])]
        assert sum(tokens) == ids.count(IMAGE_ID) and len(tokens) == len(images)
        whole = processor.apply_chat_template(messages, tokenize=True, return_dict=True, **options)["input_ids"]
        assert whole[0] == ids or whole == ids, "the two ways of the reference differ"
        turns = [{"role": role, "content": parts} for role, parts in turns]
        made.append({
            "name": name, "messages": turns, "number_images": options["add_vision_id"], "text": text,
            "tokens": tokens, "ids": ids,
        })
        print(f"{name}: {len(ids)} ids, images of {tokens} tokens")
    lines = ",\n".join(json.dumps(m) for m in made)
    out.write_text(f"[\n{lines}\n]\n")


if __name__ == "__main__":
    main()
