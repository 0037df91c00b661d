// A choice of light, dark or high contrast -> attribute of the page, kept in the browser.

const THEMES = ["light", "dark", "contrast"];
const THEME_NAMES = { light: "light", dark: "dark", contrast: "high contrast" };
const THEME_KEY = "falconwing-theme";

/** A value kept in this browser; null where the browser keeps nothing. */
export function keptValue(key) {
  try {
    return localStorage.getItem(key);
  } catch {
    return null;
  }
}

/** Keep a value in this browser, if it can. */
export function keepValue(key, value) {
  try {
    localStorage.setItem(key, value);
  } catch {
    // A private window: the choice holds until the page closes.
  }
}

/** A colour of the style sheet by its name, as the theme sets it. */
export function themeColor(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** The page's theme. Buttons change it; `onchange` runs after each change. */
export class Theme {
  constructor(buttons) {
    this.onchange = () => {};
    const kept = keptValue(THEME_KEY);
    this.chosen = THEMES.includes(kept);
    this.name = this.chosen ? kept : this.preferred();
    this.buttons = buttons;
    for (const button of buttons) button.addEventListener("click", () => this.next());
    for (const query of ["(prefers-color-scheme: dark)", "(prefers-contrast: more)"]) {
      matchMedia(query).addEventListener("change", () => this.follow());
    }
    this.show();
  }

  preferred() {
    if (matchMedia("(prefers-contrast: more)").matches) return "contrast";
    return matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  }

  /** Take over what the system asks for, unless a theme was chosen here. */
  follow() {
    if (this.chosen) return;
    this.name = this.preferred();
    this.show();
  }

  next() {
    this.name = THEMES[(THEMES.indexOf(this.name) + 1) % THEMES.length];
    this.chosen = true;
    keepValue(THEME_KEY, this.name);
    this.show();
  }

  show() {
    document.documentElement.dataset.theme = this.name;
    for (const button of this.buttons) button.textContent = `Theme: ${THEME_NAMES[this.name]}`;
    this.onchange(this.name);
  }
}
