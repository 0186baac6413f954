// On a narrow screen the panels of a figure stand one below another: windows on the whole picture.
"use strict";
for (const picture of document.querySelectorAll("img[data-panels]")) {
  const [width, height] = ["width", "height"].map((name) => Number(picture.getAttribute(name)));
  const parts = document.createElement("span");
  parts.className = "panels";
  parts.setAttribute("role", "img");
  parts.setAttribute("aria-label", picture.alt);
  for (const box of picture.dataset.panels.split(" ")) {
    const [left, top, right, bottom] = box.split(",").map(Number);
    const [across, down] = [right - left, bottom - top];
    const part = document.createElement("span");
    // half its size at least, where its letters are eight pixels high, and twelve at most
    part.style.cssText = `width: clamp(${0.5 * across}px, 100%, ${0.75 * across}px);
      aspect-ratio: ${across} / ${down}`;
    const whole = new Image();
    whole.alt = "";
    whole.src = picture.src;
    whole.style.cssText = `width: ${(100 * width) / across}%; height: ${(100 * height) / down}%;
      left: ${(-100 * left) / across}%; top: ${(-100 * top) / down}%`;
    part.append(whole);
    parts.append(part);
  }
  picture.after(parts);
}
