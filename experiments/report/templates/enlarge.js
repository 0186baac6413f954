// A figure's picture, tapped or chosen by key, opens as large as it is; Escape closes it.
"use strict";
const shown = document.createElement("dialog");
shown.className = "enlarged";
shown.addEventListener("click", () => shown.close());
document.body.append(shown);
for (const picture of document.querySelectorAll("figure img")) {
  const button = document.createElement("button");
  button.className = "enlarge";
  button.title = "Enlarge";
  picture.replaceWith(button);
  button.append(picture);
  button.addEventListener("click", () => {
    const large = picture.cloneNode();
    large.style.width = `${Math.max(picture.naturalWidth, innerWidth - 40)}px`;
    shown.replaceChildren(large);
    shown.showModal();
  });
}
